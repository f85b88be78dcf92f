"""Data sets in object stores: written by any number of equal workers, resumed, finalized and read where they lie. See README.md."""
