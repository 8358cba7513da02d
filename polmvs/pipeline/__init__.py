"""The jobs and their stages, the run's folder and its record."""
