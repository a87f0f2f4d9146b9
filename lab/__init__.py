"""What is beside the package and never ships: measurements, methods of others, studies that are over, and a notebook."""
