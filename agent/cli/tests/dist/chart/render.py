"""Renders the chart with Helm's own library and validates it against the API of Kubernetes.

    render.py CHART VALUES

prints the documents as YAML. VALUES is JSON. Fails if Helm finds an error in the chart or the
values, or if a resource of Kubernetes itself does not follow its schema strictly.
"""
import json
import sys

import helm_python
import kubernetes_validate
import yaml

OLDEST, NEWEST = "1.25.0", "1.37.0"


def main(path, values):
    linted = helm_python.lint(path)
    if linted["errors"]:
        sys.exit(str(linted["errors"]))
    with helm_python.Chart.load(path) as chart:
        values = json.loads(values)
        chart.validate_schema(values)
        rendered = chart.render(values, name="ros2probe", namespace="ros2probe")
    for name, text in sorted(rendered.items()):
        if not name.endswith(".yaml"):
            continue
        for document in filter(None, yaml.safe_load_all(text)):
            if not document["apiVersion"].startswith("monitoring.coreos.com/"):
                for version in (OLDEST, NEWEST):
                    kubernetes_validate.validate(document, version, strict=True)
            print("---\n" + yaml.safe_dump(document))


main(*sys.argv[1:])
