"""YOLO labels: boxes, oriented boxes and segments of the visible masks."""
