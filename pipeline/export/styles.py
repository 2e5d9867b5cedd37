"""Styles of QGIS 3, by the stem of the raster that they are for; ``$name`` is filled in."""

DEM = """<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22" styleCategories="Symbology" hasScaleBasedVisibilityFlag="0">
  <pipe>
    <rasterrenderer type="singlebandpseudocolor" band="1" opacity="1" alphaBand="-1"
      nodataColor="" classificationMin="$e0" classificationMax="$e8">
      <minMaxOrigin>
        <limits>None</limits>
        <extent>WholeRaster</extent>
        <statAccuracy>Estimated</statAccuracy>
      </minMaxOrigin>
      <rastershader>
        <colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="0"
          minimumValue="$e0" maximumValue="$e8">
          <item value="$e0" label="$e0" color="#00224e" alpha="255"/>
          <item value="$e1" label="$e1" color="#1a386f" alpha="255"/>
          <item value="$e2" label="$e2" color="#434e6c" alpha="255"/>
          <item value="$e3" label="$e3" color="#61656f" alpha="255"/>
          <item value="$e4" label="$e4" color="#7d7c78" alpha="255"/>
          <item value="$e5" label="$e5" color="#9b9476" alpha="255"/>
          <item value="$e6" label="$e6" color="#bcae6c" alpha="255"/>
          <item value="$e7" label="$e7" color="#dec958" alpha="255"/>
          <item value="$e8" label="$e8" color="#fee838" alpha="255"/>
        </colorrampshader>
      </rastershader>
    </rasterrenderer>
    <brightnesscontrast brightness="0" contrast="0"/>
    <huesaturation saturation="0" grayscaleMode="0" colorizeOn="0"/>
    <rasterresampler maxOversampling="2"/>
  </pipe>
  <blendMode>0</blendMode>
</qgis>
"""

RISK = """<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22" styleCategories="Symbology" hasScaleBasedVisibilityFlag="0">
  <pipe>
    <rasterrenderer type="paletted" band="1" opacity="0.8" alphaBand="-1" nodataColor="">
      <colorPalette>
        <paletteEntry value="0" label="safe" color="#a6d7c3" alpha="255"/>
        <paletteEntry value="1" label="caution" color="#f0d68a" alpha="255"/>
        <paletteEntry value="2" label="hazard" color="#c8501e" alpha="255"/>
        <paletteEntry value="3" label="unknown (never entered)" color="#8d8f98" alpha="255"/>
      </colorPalette>
    </rasterrenderer>
    <brightnesscontrast brightness="0" contrast="0"/>
    <huesaturation saturation="0" grayscaleMode="0" colorizeOn="0"/>
    <rasterresampler maxOversampling="2"/>
  </pipe>
  <blendMode>0</blendMode>
</qgis>
"""
