"""Check the recipe and render it as conda-forge would, without solving: ``python packaging/conda/render.py``.

Needs py-rattler-build.
"""

from __future__ import annotations

from pathlib import Path

from rattler_build import PlatformConfig, RenderConfig, Stage0Recipe, VariantConfig

VARIANTS = {
    "python": ["3.10.* *_cpython", "3.11.* *_cpython", "3.12.* *_cpython", "3.13.* *_cp313"],
    "cxx_compiler": ["gxx"],
    "cxx_compiler_version": ["14"],
    "c_stdlib": ["sysroot"],
    "c_stdlib_version": ["2.17"],
}

if __name__ == "__main__":
    recipe = Stage0Recipe.from_file(str(Path(__file__).with_name("recipe.yaml")))
    settings = RenderConfig(platform=PlatformConfig(target_platform="linux-64"))
    for variant in recipe.render(VariantConfig(VARIANTS), settings):
        found = variant.recipe.to_dict()
        print(f"{variant}: {found['requirements']}")
