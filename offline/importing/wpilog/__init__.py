"""Import of WPILib data logs (.wpilog) of FRC robots."""
