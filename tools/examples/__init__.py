"""Examples of the Python API, run as `python -m tools.examples.NAME FOLDER`; each bakes a small data set if the folder has none."""
