"""An error-state Kalman filter over inertial measurements, ranges, craters and relative motion."""
