"""Join components over the single tags that they share, once each is solved on corners."""
