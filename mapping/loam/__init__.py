"""LOAM's mapping (Zhang and Singh, RSS 2014): edge and planar features registered to a map of each."""
