"""The devices of the simulated line, free of any wire: what a drive, an amplifier and a line PLC do. Faces encode."""
