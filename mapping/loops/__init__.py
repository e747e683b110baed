"""Loop closure: candidates, verification, registration."""
