"""Datasets of expert episodes: collect, store, verify and load them."""
