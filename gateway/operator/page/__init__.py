"""The web page of a line: what people see of it, and the way what they decide takes to the gateway."""
