"""The report page with its pictures, plots and 3D view, and still renderings."""
