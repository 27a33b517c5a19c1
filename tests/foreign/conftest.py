from tests.cli.conftest import projservo  # noqa: F401 - the command line as in its own tests
