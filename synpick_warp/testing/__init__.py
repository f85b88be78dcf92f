"""Tests for packages of others: contract tests of exporters, on views of boxes that are known analytically.

    from synpick_warp.testing.exporters import ExporterContract

    class TestBoxes(ExporterContract):      # a class of a pytest file
        exporter_class, row = BoxesExporter, FORMAT

Needs pytest. Writer processes import your module: install your package, or put its folder on PYTHONPATH, not on sys.path alone. Nothing
in synpick_warp imports this package.
"""
