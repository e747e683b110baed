"""Commands that write the results of a run in the formats of other programs."""
