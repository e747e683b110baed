"""What sensors send over the network, as recorded: packets, decoded by the libraries of the makers and of others."""
