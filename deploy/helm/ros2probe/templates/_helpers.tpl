{{- define "ros2probe.fullname" -}}
{{- if contains "ros2probe" .Release.Name -}}
{{- .Release.Name | trunc 63 | trimSuffix "-" -}}
{{- else -}}
{{- printf "%s-ros2probe" .Release.Name | trunc 63 | trimSuffix "-" -}}
{{- end -}}
{{- end -}}

{{- define "ros2probe.selector" -}}
app.kubernetes.io/name: ros2probe
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end -}}

{{- define "ros2probe.labels" -}}
{{ include "ros2probe.selector" . }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version }}
{{- end -}}

{{- /* The values of the chart take precedence: they agree with the mounts and the ports. */ -}}
{{- define "ros2probe.configuration" -}}
{{- $fixed := dict
      "capture" (dict "cgroup" "/host/cgroup")
      "metrics" (dict "listen" (printf "0.0.0.0:%d" (int .Values.metrics.port))) -}}
{{- mergeOverwrite (deepCopy .Values.configuration) $fixed | toYaml -}}
{{- end -}}
