"""Developer tools: benchmarks, reports, checks. Run as `python -m tools.NAME`."""
