"""The examples in the core's docstrings run and show what they say."""

import doctest
import importlib
import pkgutil

import pytest

import wallmirror
import wallmirror.brdf
import wallmirror.captures
import wallmirror.convolution
import wallmirror.deconvolution
import wallmirror.derendering

CORE = sorted(
    module.name
    for package in (
        wallmirror,
        wallmirror.brdf,
        wallmirror.captures,
        wallmirror.convolution,
        wallmirror.deconvolution,
        wallmirror.derendering,
    )
    for module in pkgutil.iter_modules(package.__path__, package.__name__ + ".")
    if not module.ispkg and module.name != "wallmirror.__main__"
)


@pytest.mark.parametrize("name", CORE)
def test_examples(name):
    module = importlib.import_module(name)
    outcome = doctest.testmod(module, extraglobs={"np": __import__("numpy")})
    assert outcome.failed == 0


def test_there_are_examples():
    assert sum(doctest.testmod(importlib.import_module(name)).attempted for name in CORE) >= 10
