"""The commands: each parses its options, imports and calls one function, and prints the result."""
