"""The commands, one a file: each parses, imports what it needs, calls one function, and says what came of it."""
