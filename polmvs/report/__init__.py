"""What people look at: the report page, its pictures, plots and 3D view, and still renderings."""
