"""Visualization of data sets from their files: contact sheets, and figures that explain pick attempts."""
