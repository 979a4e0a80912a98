# An image whose command is colmap_sph:
#
#     docker build --tag colmap_sph .
#     docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/work" colmap_sph run --model sparse/0
FROM python:3.13-slim-bookworm AS build
RUN apt-get update \
    && apt-get install --yes --no-install-recommends gcc libc6-dev \
    && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN python -m venv /opt/colmap_sph && /opt/colmap_sph/bin/pip install --no-cache-dir /source

FROM python:3.13-slim-bookworm
COPY --from=build /opt/colmap_sph /opt/colmap_sph
# Whoever runs it may have no home there.
ENV PATH=/opt/colmap_sph/bin:$PATH HOME=/tmp PYTHONDONTWRITEBYTECODE=1
WORKDIR /work
RUN chmod 1777 /work
ENTRYPOINT ["colmap_sph"]
