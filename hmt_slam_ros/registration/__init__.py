"""Registration: every way of laying scans on maps, maps on maps, and scans on each other."""
