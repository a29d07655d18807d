"""Published checkpoints of other code, turned into this package's model folders.

A new kind of checkpoint needs one module: read with :mod:`controlmm.convert.torch_file`, rename with
:mod:`controlmm.convert.renaming`, write inside :func:`controlmm.convert.output_folder.new_folder`.
"""
