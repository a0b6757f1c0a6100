"""EP2-SINDy: governing equations of oscillations, found in data; `import ep2sindy as ep`.

The names for users stand in the stub next to this file, and in those of the rooms, such as
`ep2sindy/thruster/__init__.pyi`. Each is loaded when it is first used, so that the import itself
costs nothing and PyTorch is loaded by those alone who refine.
"""

from ep2sindy._stubs import attach

__getattr__, __dir__ = attach(__name__)
