"""The commands, one a file: each parses its options, imports and calls one function, and prints the result."""
