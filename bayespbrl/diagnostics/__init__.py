"""What a researcher puts before a reviewer: convergence, calibration, influence, pictures."""
