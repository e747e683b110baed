"""Readers, one per file; the registry lists them.

A fault of a recording or of its settings that a user can mend is an `InputError`, which says how.
"""
