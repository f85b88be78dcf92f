"""Object stores: the interface, an implementation for each library (obstore, fsspec), and the choice by URL."""
