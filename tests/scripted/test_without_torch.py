"""What is asked before any training does not need PyTorch, which takes seconds to import."""

from one_line import python


def test_their_modules():
    code = "import sys; from tactilerl.commands import design, env, gate, hand"
    done = python("-c", f"{code}; assert 'torch' not in sys.modules")
    assert done.returncode == 0, done.stderr
