"""The machine and files: hardware, processes, untrusted input, codecs; folders, descriptors, progress lines, low-discrepancy points."""
