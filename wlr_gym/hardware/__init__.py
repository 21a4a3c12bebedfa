"""The real robot: Dynamixel protocol, control tables, bus groups, and an emulator of the eight servos and the IMU."""
