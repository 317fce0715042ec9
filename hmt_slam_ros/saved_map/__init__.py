"""Saved values: a folder of documents and arrays that is verified when read and replaced atomically."""
