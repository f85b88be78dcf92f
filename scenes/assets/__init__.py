"""Asset import: BOP folders, meshes (PLY, OBJ, glTF, STL), textures, from folders that may come from anywhere."""
