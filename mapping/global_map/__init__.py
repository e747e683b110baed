"""The merged global map."""
