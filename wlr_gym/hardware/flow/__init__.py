"""The optical-flow sensor: its chip, frames of a microcontroller that reads it, one interface over both, supervision."""
