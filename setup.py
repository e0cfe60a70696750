from glob import glob

from setuptools import find_packages, setup

NAME = "socket_testbed"

NODES = (
    "trigger",
    "cluster",
    "load_cell",
    "mocap",
    "calibration",
    "estimator",
    "recorder",
    "replay",
)

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", glob("config/*.yaml")),
        (f"share/{NAME}/launch", glob("launch/*.py")),
        # The offline side reads trials with the same message definitions, without ROS.
        (f"share/{NAME}/msg", glob("msg_defs/msg/*.msg")),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},  # without it, colcon test runs no test
    zip_safe=True,
    maintainer="socket_testbed maintainers",
    maintainer_email="maintainers@socket-testbed.org",
    description="Software of an instrumented prosthetic-socket testbed.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"socket-testbed = {NAME}.__main__:main",
            *(f"{node}_node = {NAME}.nodes.{node}_node:main" for node in NODES),
        ]
    },
)
