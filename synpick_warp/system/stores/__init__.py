"""Object stores by obstore: S3, Google Cloud Storage, Azure; retries, and the choice by URL."""
