"""The report of a run: ``report.json`` for programs and ``report.html``, one file, for people.

Facts, all that is said, as data: :mod:`~rille.pipeline.report.gather` reads the artifacts, ``metrics``, ``tables`` and
``delivery`` compute, ``summary`` collects them. Figures: ``gallery`` lists them, ``figures``, ``strips`` and
``terrain_map`` draw. The page, ``template.html``, puts facts into words and figures in their places.
"""
