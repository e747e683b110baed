"""From motions to maps: deskewing, the global map, and what corrects both."""
