"""What every package may use: errors, files, paths, provenance, random numbers, settings. Imports nothing above it."""
