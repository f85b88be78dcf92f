"""Views, one camera picture each: the table of their layers, their arrays in host memory, and files of layers."""
