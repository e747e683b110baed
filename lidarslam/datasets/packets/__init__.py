"""Recorded network packets of sensors, decoded by the libraries of the makers and of others."""
