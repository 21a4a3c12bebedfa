"""What every package may use: errors, files, jobs, paths, provenance, random numbers, reports, settings.

Imports nothing above it.
"""
