"""Other programs on the same scans: each is a library in a process of its own, with poses at the scans' stamps."""
