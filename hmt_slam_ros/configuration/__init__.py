"""The one configuration tree."""
