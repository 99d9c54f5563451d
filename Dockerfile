# The command line in a container, with compiled kernels (x86-64: for AVX2 and AVX-512), as a user without rights:
#   docker build -t dudmap .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" dudmap run RECORDING --out my_run
ARG BASE=python:3.12-slim
FROM ${BASE} AS build
COPY . /dudmap
WORKDIR /dudmap
RUN python -m venv /opt/dudmap && /opt/dudmap/bin/pip install --no-cache-dir --require-hashes -r requirements/run.txt
RUN /opt/dudmap/bin/pip install --no-index --no-build-isolation --no-deps . && \
    if [ "$(uname -m)" = x86_64 ]; then \
        /opt/dudmap/bin/python -m dudmap.lab.wheel_kernels /kernels && DUDMAP_KERNELS=/kernels \
        /opt/dudmap/bin/pip install --force-reinstall --no-index --no-build-isolation --no-deps .; \
    fi

FROM ${BASE}
COPY --from=build /opt/dudmap /opt/dudmap
ENV PATH=/opt/dudmap/bin:$PATH HOME=/tmp MPLCONFIGDIR=/tmp/matplotlib
USER nobody
WORKDIR /data
ENTRYPOINT ["dudmap"]
