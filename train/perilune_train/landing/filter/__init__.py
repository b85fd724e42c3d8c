"""An error-state Kalman filter over inertial measurements, ranges and craters."""
