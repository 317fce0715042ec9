"""Values that outlast a process: a folder of documents and arrays, checked when it is read, replaced at one stroke."""
