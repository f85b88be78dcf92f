"""COCO instance segmentation: images, and one annotation file for each split."""
