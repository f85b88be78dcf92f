"""Asset import: BOP folders, meshes (PLY, OBJ, GLB), textures, from folders that may come from anywhere."""
