"""Write datasets: render trajectories, resume, finish, develop EXRs, regenerate frames."""
