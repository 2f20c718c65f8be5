"""What commands of experiments cannot do, and what is called otherwise now: one sentence, and nothing is made."""

import importlib

import pytest

REFUSED = [
    ("active_touch --objects star mug", "mug"),
    ("active_touch --objects star star", "each named once"),
    ("calibrate --dataset DIR --calibration skin.npz --save-pad pad.npz", "pass --dataset DIR"),
    ("calibrate --calibration skin.npz", "--calibration is for --save-pad FILE"),
    ("fidelity --dataset x --simulated-skins 1", "--simulated-skins"),
    ("recognize live --prior-unknown 0.1 --num-surrogates 0", "surrogates"),
    ("recognize live --skin replay --pad nominal", "feels nothing that this arm touches"),
    ("reconstruct --meshes nowhere", "nowhere"),
    ("reconstruct --side 0.09 0.06", "give the smaller one first"),
    ("reconstruct --conditions guess", "is none of random"),
    ("reconstruct --dataset nowhere", "there is no such data set"),
    ("reconstruct --arm simulated", "--arm has no effect without --true-object"),
    ("reconstruct --true-object star", "--true-object has no effect without --arm"),
    ("reconstruct --arm simulated --true-object nothing", "nor an object of the catalogue"),
    ("reconstruct --arm simulated --true-object star --conditions random", "simulated objects"),
    ("reconstruct --name mine", "--name has no effect without --dataset or --arm"),
]
RENAMED = [
    ("calibrate --dataset DIR --earlier DIR", "--previous-session"),
    ("train --split run", "--split run is called --split session now"),
]


@pytest.mark.parametrize(("words", "said"), REFUSED + RENAMED)
def test_one_sentence_says_what_is_wrong_and_nothing_is_made(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    package, *arguments = words.split()
    main = importlib.import_module(f"experiments.{package}.__main__").main
    try:
        code = main([*arguments, "--out", "out"])
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
