"""Range images, normals and bird's-eye grids."""
