"""Clients: other people's readers of our formats, tried on a small data set. A file per client; `python -m tools.clients DATA` runs all."""
