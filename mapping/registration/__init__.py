"""Registration of scans to a local map of any kind, by robust Gauss-Newton."""
