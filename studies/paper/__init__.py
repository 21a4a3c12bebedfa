"""The paper this project started from: its equations as printed and corrected, its two tests, its claims, its open question."""

from studies.paper.experiments import TESTS, Record, drive, drive_both
from studies.paper.verdicts import EQUATIONS, Equation

__all__ = ["EQUATIONS", "TESTS", "Equation", "Record", "drive", "drive_both"]
