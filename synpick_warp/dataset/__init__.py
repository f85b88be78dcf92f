"""Data sets on disk: manifest, commit and resume, merge, verification, reading."""
