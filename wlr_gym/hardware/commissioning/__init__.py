"""Commissioning: scripted tests of a robot on a stand, each compared with the emulated robot of the same hardware file."""
