"""The names of the field's metrics with their units. Lower is better."""

UNITS = {
    "MPJRE": "deg", "geodesic": "deg", "MPJPE": "cm", "Hand PE": "cm", "Upper PE": "cm", "Lower PE": "cm",
    "Root PE": "cm", "MPJVE": "cm/s", "Jitter": "10^2 m/s^3", "GT Jitter": "10^2 m/s^3",
}  # fmt: skip
