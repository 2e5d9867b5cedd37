"""Programs and stages that the torture of the engine runs on."""
