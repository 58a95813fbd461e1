"""The torch examples recover what they should; each writes a picture, and goes on where it was stopped."""

import pytest
import torch
from example_files import example


def check_files(folder, *names, kind="png"):
    for name in names:
        assert (folder / f"{name}.{kind}").stat().st_size > 5000 and (folder / f"{name}.state").exists()


def test_identify(tmp_path, capsys):
    result = example("identify/identify_torch").main(tmp_path)
    assert result["falling"]["E_error"] < 0.01
    assert result["sagging"]["E_error"] < 1e-3 and result["sagging"]["iterations"] <= 10
    assert result["both"]["E_error"] < 0.01 and result["both"]["nu_error"] < 0.01
    check_files(tmp_path, "identify_falling", "identify_sagging", "identify_both")
    out = capsys.readouterr().out
    assert all(word in out for word in ("E_error", "nu_error", "iterations", "seconds"))
    assert result["sagging"]["unseen"] == 1 and "NOT SEEN" in out  # E and density together, under gravity alone


def test_resumed_controller_is_the_uninterrupted_one(tmp_path, monkeypatch):
    module, states = example("control/train_controller"), []
    monkeypatch.setattr(module, "save_reaches", lambda *_, **__: None)
    for folder, stops in (("whole", [6]), ("parts", [3, 6])):
        for stop in stops:
            result = module.main(tmp_path / folder, iterations=stop)
        states.append({key: value for key, value in result.items() if key != "seconds"})
    assert states[0] == states[1]


@pytest.fixture(autouse=True)
def default_dtype():
    torch.set_default_dtype(torch.float32)
