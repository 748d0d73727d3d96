from xml.etree import ElementTree

from setuptools import setup

NAME = 'ros2probe_cli'
package = ElementTree.parse('package.xml')
maintainer = package.find('maintainer')

setup(
    name=NAME,
    version=package.findtext('version'),
    description=package.findtext('description').strip(),
    maintainer=maintainer.text,
    maintainer_email=maintainer.get('email'),
    license='Apache-2.0 OR MIT',
    packages=[NAME],
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + NAME]),
        ('share/' + NAME, ['package.xml']),
    ],
    install_requires=['setuptools'],
    zip_safe=True,
    entry_points={'ros2cli.command': ['probe = ros2probe_cli.command:ProbeCommand']},
)
