"""Area Abstraction Mechanism, process 2 of the paper: where an area ends."""
