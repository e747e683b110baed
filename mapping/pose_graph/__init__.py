"""The pose graph: keyframes, edges, optimisation."""
