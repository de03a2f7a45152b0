-- Run once, by the database's image, when its volume is still empty; Prefect's database is made by that image itself.
CREATE DATABASE mlflow;
