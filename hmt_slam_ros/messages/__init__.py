"""The messages between the processes, their documents, who hears what, and the map as messages tell it."""
