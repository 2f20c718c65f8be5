"""Commands that end with one sentence."""


def refused(capsys, main, *words, why, code=2):
    """Require that a command ends with this code and with one line that states the reason."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == code
    said = capsys.readouterr().err
    assert why in said
    assert said.count("\n") == 1
