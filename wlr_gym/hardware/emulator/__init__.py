"""Eight emulated servos and an IMU that speak their real protocols on pseudo-terminals, with a simulator behind them."""

from wlr_gym.hardware.emulator.faults import FAULTS, Fault, parse_fault
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
from wlr_gym.hardware.emulator.server import Server

__all__ = ["FAULTS", "Fault", "Machine", "MachineOptions", "Server", "parse_fault"]
