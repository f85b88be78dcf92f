"""Asset import: BOP folders, meshes (PLY, OBJ, glTF, STL, STEP), textures, from folders that may come from anywhere."""
