"""Tracking state, registration attempts and relocalisation."""
