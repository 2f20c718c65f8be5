"""What commands of experiments cannot do: one sentence, and nothing is made."""

import importlib

import pytest

REFUSED = [
    ("active_touch --objects star mug", "mug"),
    ("active_touch --objects star star", "each named once"),
    ("calibrate --dataset DIR --simulated", "pass one of --dataset DIR"),
    ("fidelity --dataset nowhere", "nowhere"),
    ("recognize live --prior-unknown 0.1 --num-surrogates 0", "surrogates"),
    ("recognize live --skin replay --pad-model nominal", "--skin replay is not known; give a name"),
    ("recognize recorded --readings nowhere --label what", "--readings nowhere: there is no such file"),
    ("recognize recorded --label what", "--readings"),
    ("reconstruct --conditions guess", "is none of reading"),
    ("reconstruct --dataset nowhere", "there is no such data set"),
    ("reconstruct --objects nowhere --unit mm", "there is no such folder"),
    ("reconstruct --objects .", "--objects has no effect without --unit"),
    ("reconstruct --unit mm", "--unit has no effect without --objects"),
    ("reconstruct --objects . --unit mm --across-mm 70 50", "give two sizes of 10 to 300 mm"),
    ("reconstruct --name mine", "--name has no effect without --dataset"),
]


@pytest.mark.parametrize(("words", "said"), REFUSED)
def test_wrong_options_are_refused_in_one_sentence_and_nothing_is_written(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    package, *arguments = words.split()
    main = importlib.import_module(f"experiments.{package}.__main__").main
    try:
        code = main([*arguments, "--out", "out"])
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    assert said in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert not (tmp_path / "out").exists()
