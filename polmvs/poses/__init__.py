"""Known poses, the metric frame, markers and triangulation."""
