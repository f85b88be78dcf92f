"""File formats: JPEG and depth as PNG, which host and device encode to the same bytes, charts by Vega-Lite, and tables."""
