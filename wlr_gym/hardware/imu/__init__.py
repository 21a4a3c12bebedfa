"""The IMU: its frames, its drivers, and one interface over both."""
