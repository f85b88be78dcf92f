"""Object stores: one interface, an implementation for each library, and the choice by URL."""
