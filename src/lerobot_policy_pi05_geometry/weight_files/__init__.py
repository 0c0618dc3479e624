"""Files that hold weights: found, loaded strictly, written whole. Imports nothing else of this package."""
