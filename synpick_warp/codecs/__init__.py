"""File formats: JPEG and depth as PNG, which host and device encode to the same bytes, and charts by Vega-Lite."""
