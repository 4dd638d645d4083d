"""What holds for every test."""

from hypothesis import settings

# A busy machine must not fail a property test.
settings.register_profile("groundsbot", deadline=None)
settings.load_profile("groundsbot")
