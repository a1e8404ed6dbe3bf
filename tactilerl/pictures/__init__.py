"""The hand and its taxels drawn: unrolled, as a picture, or as a film."""
