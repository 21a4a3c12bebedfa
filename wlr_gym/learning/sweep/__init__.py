"""Sweeps: settings x seeds, or a search, as trials that can be resumed one by one, on this machine or a Ray cluster."""
