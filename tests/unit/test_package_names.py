"""What a package offers must not be hidden by a module of the same name that is imported later."""

import subprocess
import sys

# In a process of its own: here other tests have imported modules already.
_LOOK = """
import importlib, pkgutil
import controlmm

found = list(pkgutil.walk_packages(controlmm.__path__, "controlmm."))
packages = [controlmm] + [importlib.import_module(name) for _, name, is_package in found if is_package]
offered = [(p, name, getattr(p, name)) for p in packages for name in getattr(p, "__all__", ())]
for package, name, _ in offered:
    if any(module.name == name for module in pkgutil.iter_modules(package.__path__)):
        importlib.import_module(f"{package.__name__}.{name}")
print(len(offered), [f"{p.__name__}.{name}" for p, name, thing in offered if getattr(p, name) is not thing])
"""


def test_no_module_hides_what_its_package_offers():
    seen = subprocess.run([sys.executable, "-c", _LOOK], capture_output=True, text=True, check=True).stdout
    count, _, hidden = seen.strip().partition(" ")
    assert int(count) > 100
    assert hidden == "[]"
