# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Build and install the distribution, for pip and for ament_python alike."""

from pathlib import Path
import re
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = 'mddag_executor'
BATCH = ['llvmlite>=0.42', 'matplotlib>=3.6']
DASK = ['distributed>=2023.5']
DOCS = [
    'mkdocs-material>=9.5', 'mkdocstrings[python]>=0.26',
    # the last mkdocstrings for Python 3.10 does not work with later ones
    'pymdown-extensions<12; python_version<"3.11"',
]
EXPORT = ['pyarrow>=14']
TEST_LIVE = [
    *BATCH, 'hypothesis', 'jsonschema', 'pytest>=7.4', 'pytest-timeout', 'pytest-xdist']


def ros(distribution: str, *packages: str) -> list[str]:
    """Return the packages of a ROS distribution as the package index names them."""
    return [f'ros-{distribution}-{package}' for package in packages]


ROS = ['common-interfaces', 'rclpy[fastrtps]', 'rmw-fastrtps-cpp']
HERE = Path(__file__).resolve().parent
# Maintainer and addresses are given there, once for all.
PACKAGE = ElementTree.parse(HERE / 'package.xml').getroot()
URLS = {url.get('type'): url.text for url in PACKAGE.iter('url')}


def version() -> str:
    """Return the version that the package itself states, without importing it."""
    text = (HERE / NAME / '__init__.py').read_text(encoding='utf-8')
    found = re.search(r"^__version__ = '([^']+)'$", text, re.MULTILINE)
    if found is None:
        raise RuntimeError(f'{NAME}/__init__.py states no __version__')
    return found.group(1)


def description() -> str:
    """Return the README for a project page elsewhere: absolute links, and no hidden comments."""
    text = (HERE / 'README.md').read_text(encoding='utf-8')
    text = re.sub(r'<!--.*?-->\n*', '', text, flags=re.DOTALL)
    text = re.sub(r'(!\[[^\]]*\])\((?!https?:|#)', rf'\1({URLS["repository"]}/raw/HEAD/', text)
    return re.sub(r'\]\((?!https?:|#)', f']({URLS["repository"]}/blob/HEAD/', text)


def files(folder: str, *patterns: str) -> list[str]:
    """Return the files of a folder that match, relative to this file as setuptools wants."""
    found = {path for pattern in patterns for path in (HERE / folder).glob(pattern)}
    return sorted(path.relative_to(HERE).as_posix() for path in found)


setup(
    name=NAME,
    version=version(),
    description='A deadline-driven executor for ROS 2 in Python, and its offline replayer',
    long_description=description(),
    long_description_content_type='text/markdown',
    license='Apache-2.0',
    maintainer=PACKAGE.findtext('maintainer'),
    maintainer_email=PACKAGE.find('maintainer').get('email'),
    url=URLS['repository'],
    project_urls={
        'Changelog': f'{URLS["repository"]}/blob/HEAD/CHANGELOG.md',
        'Documentation': f'{URLS["repository"]}/blob/HEAD/docs/index.md',
        'Source': URLS['repository'],
        'Tracker': URLS['bugtracker'],
    },
    classifiers=[
        'Development Status :: 5 - Production/Stable',
        'Intended Audience :: Developers',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Programming Language :: Python :: 3.10',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Topic :: Scientific/Engineering',
        'Topic :: Software Development :: Debuggers',
        'Typing :: Typed',
    ],
    keywords=['ROS 2', 'rclpy', 'executor', 'real time', 'scheduling', 'deadline'],
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*', 'msg_graph', 'msg_graph.*']),
    package_data={NAME: ['py.typed', 'report/*.css', 'report/*.js'], 'msg_graph': ['py.typed']},
    zip_safe=False,
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        # for `ros2 run` and the launch action Node
        (f'lib/{NAME}', ['resource/mddag']),
        (f'share/{NAME}/launch', files('launch', '*.launch.py')),
        (f'share/{NAME}/config', files('config', '*.yaml', '*.md')),
        (f'share/{NAME}/bags', files('bags', '*.mcap', '*.md')),
    ],
    # The ROS packages are not among these: with an installed ROS they come from rosdep, and the
    # extra `ros` brings them from the package index for those who have none.
    install_requires=[
        'argcomplete>=1.10',
        'PyYAML>=5.4',
        # checksums of recordings; without it they take longer
        'isal>=1.1; platform_machine in "aarch64 x86_64"',
        'lz4>=3.1',
        'mcap>=1.0',
        'numpy>=1.21',
        'rosbags>=0.10',
        'zstandard>=0.18',
    ],
    extras_require={
        # many simulated runs at compiled speed, and their figures
        'batch': BATCH,
        # those runs on more than one machine
        'dask': DASK,
        # make docs
        'docs': DOCS,
        # files for data frames
        'export': EXPORT,
        'ros': ros('jazzy', *ROS),
        # instead of `ros`
        'ros-kilted': ros('kilted', *ROS),
        'test': [
            *DASK,
            *DOCS,
            *EXPORT,
            *TEST_LIVE,
            'colcon-bash',
            'colcon-package-selection',
            'colcon-ros',
            'colcon-test-result',
            # the examples of docs/tables.md
            'duckdb',
            'pandas>=1.5',
            # new versions have new findings
            'mypy==2.4.1',
            'ruff==0.17.6',
            'perfetto>=0.11',
            *ros('jazzy', 'test-msgs'),
            'selenium>=4.10',
            'setuptools>=64',
            'types-PyYAML',
            'wheel',
        ],
        # make test-kilted
        'test-kilted': [*TEST_LIVE, *ros('kilted', 'test-msgs')],
    },
    entry_points={
        'console_scripts': ['mddag = mddag_executor.__main__:main'],
        'ros2cli.command': ['mddag = mddag_executor.cli.ros2:MddagCommand'],
    },
)
