"""What a window shows of a saved series; the window itself needs a display (DISPLAY) and a Vulkan driver."""

from types import SimpleNamespace

import numpy as np
import pytest

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.series import Series
from diffsim_ti.viewer import SavedFrames, Viewer


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    cube = TetrahedralMesh.create_cube(3, 0.2)
    out, ones = Series(tmp_path_factory.mktemp("series"), cube, "cube"), np.ones(cube.num_tetrahedra)
    for k in range(3):
        offset = np.zeros(cube.vertices.shape) + [0, 0.2 * k, 0]
        fields = SimpleNamespace(von_mises=1e3 * k * ones, energy_density=k * ones, J=(1 - 0.1 * k) * ones)
        out.write(0.1 * k, cube.vertices + offset, offset, offset, fields)
    return out.path


def test_saved_frames_give_state_fields_and_limits(series):
    source = SavedFrames(series)
    time, positions, fields, notes = source.frame(2)
    assert len(source) == 3 and time == pytest.approx(0.2) and "0.8" in notes[0]
    assert positions[:, 1].min() == pytest.approx(0.4) and fields["speed"] == pytest.approx(0.4)
    assert source.colouring("von_mises").limits == pytest.approx((0, 2000))
    assert source.colouring("J").limits == pytest.approx((0.8, 1.2))
    assert source.box()[:, 1] == pytest.approx([0, 0.6])


def test_without_a_display_the_viewer_says_what_to_do(series, monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    source = SavedFrames(series)
    with pytest.raises(RuntimeError, match="diffsim-ti render"):
        Viewer(source.mesh, source)
    with pytest.raises(ValueError, match="must be one of"):
        Viewer(source.mesh, source, "mass")
