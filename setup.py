import re
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = "socket_testbed"
VERSION = re.search(r'__version__ = "(.+)"', Path(f"{NAME}/version.py").read_text())[1]


def requirements(name: str) -> list[str]:
    lines = Path(f"requirements/{name}.txt").read_text().splitlines()
    return [line.partition("#")[0].strip() for line in lines if line.strip() and line[0] != "#"]


# The fields of `TestbedSettings`, one per node
SETTINGS = Path(f"{NAME}/settings/testbed.py").read_text()
NODES = re.findall(r"^    (\w+_node): ", SETTINGS, flags=re.MULTILINE)

setup(
    name=NAME,
    version=VERSION,
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["pages/static/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", glob("config/*")),
        (f"share/{NAME}/launch", glob("launch/*.py")),
        # The offline side reads trials with the same message definitions, without ROS.
        (f"share/{NAME}/msg", glob("msg_defs/msg/*.msg")),
    ],
    python_requires=">=3.11,<3.14",
    install_requires=requirements("runtime"),  # of the offline part; ROS has its own installation
    # Without "test", colcon test runs no test.
    extras_require={
        "test": ["pytest"],
        "c3d": requirements("c3d"),
        "completion": requirements("completion"),
    },
    zip_safe=True,
    url="https://arxiv.org/abs/2606.04222",  # the method
    author="socket_testbed maintainers",
    author_email="maintainers@example.org",
    maintainer="socket_testbed maintainers",
    maintainer_email="maintainers@example.org",
    description="Software of an instrumented prosthetic-socket testbed.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"socket-testbed = {NAME}.__main__:main",
            *(f"{node} = {NAME}.nodes.__main__:main" for node in NODES),
        ]
    },
)
