import numpy as np

from polmvs.surface.grazing import outline_bias


def test_edges_have_none_and_rounder_surfaces_more():
    bias = outline_bias(np.array([0.0, 1.0, 10.0, 100.0, 1e6]))
    assert (np.diff(bias) > 0).all()
    assert bias[0] < 0.06
    assert 0.3 < bias[3] < 0.5  # integrated by another program, with a blur of 0.8 px: 0.42
    assert bias[-1] < 1.5
