"""The paper's four experiments (ECCV 2022, section 5) on any capture with ground truth.

``phase``: error of the forward models. ``plane``: normal of a planar region from one view.
``tracks``: normals of surface points from K views. ``contours``: tracing from seeds on the edge.
Each is a function from a :class:`polmvs.experiments.data.Scene` to a typed result;
:mod:`polmvs.experiments.output` turns results into files.
"""
