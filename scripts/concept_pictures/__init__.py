"""The pictures of docs/concepts, drawn by scripts/draw_concepts.py."""
