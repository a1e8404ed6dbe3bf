"""Write a hand's file from a bare model: what its parts are, open and closed (`tactilerl hand`)."""
