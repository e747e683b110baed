"""Parts of pictures: the view, the shaded clouds, paths and legend."""
