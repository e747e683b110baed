"""One reader a file; the registry names them."""
