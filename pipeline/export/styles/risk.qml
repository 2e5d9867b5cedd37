<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
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
