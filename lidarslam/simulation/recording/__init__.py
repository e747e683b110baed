"""Recording a simulated sensor."""
