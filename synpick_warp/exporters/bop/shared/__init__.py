"""Files of a BOP dataset that its scenes share: models, camera, notes, the toolkit's entry, target lists."""
