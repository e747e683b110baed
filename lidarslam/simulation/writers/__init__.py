"""One file format a module; the registry names them."""
