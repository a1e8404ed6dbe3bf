"""How a command ends that was given what is not allowed."""

from tactilerl.commands.cli import main


def fails_with(capsys, args, *words, code=2):
    """An exit code and one line, with all the words, which is returned."""
    capsys.readouterr()
    assert main([*map(str, args)]) == code
    out, err = capsys.readouterr()
    assert err.startswith("tactilerl: error: ")
    assert err.count("\n") == 1
    assert len(err) < 800
    assert "Traceback" not in out + err
    for word in words:
        assert word in err, err
    return err
