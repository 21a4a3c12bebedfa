"""What is shown with the library: benchmarks, the paper, the demo. Imported by the command line only."""
