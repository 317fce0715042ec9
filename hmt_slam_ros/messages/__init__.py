"""The messages between the processes, their documents and subscriptions, and the replica of the map."""
