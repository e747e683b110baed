"""Products of a finished map: occupancy grid, mesh, georeference."""
